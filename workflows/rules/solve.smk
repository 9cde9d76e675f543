# The only expensive and only timed stage: one job per method and chunk, in worker processes that may die.
# `--resources timing=1` runs one job at a time, for undisturbed times.
# Only methods with the front end `oracle` receive true pairs, among random ones.
def oracle_truth(wildcards):
    method = EXPERIMENT.method(wildcards.method)
    has_oracle = registry.oracle_outliers(method.baseline, method.options) is not None
    return [f"{OUT}/truth/{wildcards.chunk}.npz"] if has_oracle else []


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
    resources:
        timing=1,
    run:
        truth = [word for path in oracle_truth(wildcards) for word in ("--truth", path)]
        files = ["--instances", input.instances, *truth, "--out", output.runs]
        run_stage("workflows", "solve", *CHOICE, "--method", wildcards.method, *files)
