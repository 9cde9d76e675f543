# Instances, and their ground truth in a separate file, which is an input only of solve jobs of methods
# with the front end `oracle`.
@functools.cache
def digest_of_sources(datasets):
    from workflows.stages.generate import sources_digest

    return sources_digest(datasets)


def generate_sources(wildcards):
    return digest_of_sources(tuple(PLAN.chunk(wildcards.chunk).datasets))


rule generate:
    input:
        f"{OUT}/fetched/{{chunk}}.json",
    output:
        instances=f"{OUT}/instances/{{chunk}}.npz",
        truth=f"{OUT}/truth/{{chunk}}.npz",
    params:
        sources=generate_sources,
    run:
        written = ["--instances", output.instances, "--truth", output.truth]
        run_stage("workflows", "generate", *CHOICE, "--chunk", wildcards.chunk, *written, plan=plan_of(wildcards.chunk))
