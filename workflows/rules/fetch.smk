# Fetches and verifies the files that the instances of a chunk need; one at a time, as chunks share files.
def fetch_cards(wildcards):
    return sources(*(f"data/{name}" for name in PLAN.chunk(wildcards.chunk).datasets))


rule fetch:
    output:
        f"{OUT}/fetched/{{chunk}}.json",
    params:
        cards=fetch_cards,
    resources:
        fetching=1,
    run:
        run_stage("workflows", "fetch", *CHOICE, "--chunk", wildcards.chunk, "--out", output[0])
