# Instances, and their ground truth in a separate file, which is an input only of solve jobs of methods
# with the front end `oracle`.
def generate_sources(wildcards):
    from workflows.stages.generate import sources_digest

    return of_datasets(sources_digest, tuple(PLAN.chunk(wildcards.chunk).datasets))


rule generate:
    input:
        f"{OUT}/fetched/{{chunk}}.json",
    output:
        instances=f"{OUT}/instances/{{chunk}}.npz",
        truth=f"{OUT}/truth/{{chunk}}.npz",
    params:
        sources=generate_sources,
    run:
        chunk = wildcards.chunk
        written = ["--instances", output.instances, "--truth", output.truth]
        run_stage("workflows", "generate", *CHOICE, "--chunk", chunk, *written, plan=plan_of(chunk))
