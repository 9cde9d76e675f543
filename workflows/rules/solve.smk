# The only expensive and only timed stage: one job per method and chunk, in workers that can be lost.
# `--resources timing=1` lets no two of them run beside each other, for undisturbed times.
# Methods with the front end `oracle` get true pairs among random ones, and no other method does.
def oracle_truth(wildcards):
    method = EXPERIMENT.method(wildcards.method)
    favoured = methods.oracle_outliers(method.baseline, method.options) is not None
    return [f"{OUT}/truth/{wildcards.chunk}.npz"] if favoured else []


rule solve:
    input:
        instances=f"{OUT}/instances/{{chunk}}.npz",
        truth=oracle_truth,
    output:
        runs=f"{OUT}/runs/{{method}}/{{chunk}}.parquet",
        trace=f"{OUT}/runs/{{method}}/{{chunk}}.trace.parquet",
    params:
        identity=solve_identity,
        fingerprint=solve_fingerprint,
        truth=lambda wildcards: " ".join(f"--truth {path}" for path in oracle_truth(wildcards)),
    resources:
        timing=1,
    shell:
        "{STAGE} solve {CHOICE} --method {wildcards.method} --instances {input.instances}"
        " {params.truth} --out {output.runs}"
