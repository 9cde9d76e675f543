# Fetches and verifies the files that the instances of a chunk need; one at a time, as chunks share files.
def fetch_cards(wildcards):
    from workflows.stages.generate import fetched_digest

    return of_datasets(fetched_digest, tuple(PLAN.chunk(wildcards.chunk).datasets))


rule fetch:
    output:
        f"{OUT}/fetched/{{chunk}}.json",
    params:
        cards=fetch_cards,
    resources:
        fetching=1,
    run:
        chunk = wildcards.chunk
        run_stage("workflows", "fetch", *CHOICE, "--chunk", chunk, "--out", output[0], plan=plan_of(chunk))
