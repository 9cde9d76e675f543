# Fetches and verifies the files that the instances of a chunk need; one at a time, as chunks share files.
@functools.cache
def digest_of_cards(datasets):
    from workflows.stages.generate import fetched_digest

    return fetched_digest(datasets)


def fetch_cards(wildcards):
    return digest_of_cards(tuple(PLAN.chunk(wildcards.chunk).datasets))


rule fetch:
    output:
        f"{OUT}/fetched/{{chunk}}.json",
    params:
        cards=fetch_cards,
    resources:
        fetching=1,
    run:
        run_stage("workflows", "fetch", *CHOICE, "--chunk", wildcards.chunk, "--out", output[0], plan=plan_of(wildcards.chunk))
