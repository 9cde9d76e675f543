# The only expensive and only timed stage: one job per method and chunk, in worker processes that may die.
# `--resources timing=1` runs one job at a time, for undisturbed times.
# Only methods with the front end `oracle` receive true pairs, among random ones.
@functools.cache
def has_oracle(name):
    method = EXPERIMENT.method(name)
    return registry.oracle_outliers(method.baseline, method.options) is not None


def oracle_truth(wildcards):
    return [f"{OUT}/truth/{wildcards.chunk}.npz"] if has_oracle(wildcards.method) else []


# On a cluster, solve jobs that share a job run one after the other: each takes all of its threads.
def solve_threads(wildcards):
    if group_sizes():
        return max(EXPERIMENT.limits_of(method).threads for method in EXPERIMENT.methods)
    return EXPERIMENT.limits_of(EXPERIMENT.method(wildcards.method)).threads


# On a cluster, as many solve jobs share a job as are expected to end within 20 minutes, one after the other.
def solve_group(wildcards):
    return solve_needs(wildcards.method, wildcards.chunk).group(group_sizes())


def solve_memory_mb(wildcards, attempt):
    return solve_needs(wildcards.method, wildcards.chunk).memory_mb(attempt)


def solve_minutes(wildcards, attempt):
    return solve_needs(wildcards.method, wildcards.chunk).minutes(attempt)


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
    threads: solve_threads
    group: solve_group
    resources:
        timing=1,
        mem_mb=solve_memory_mb,
        runtime=solve_minutes,
    run:
        truth = [word for path in oracle_truth(wildcards) for word in ("--truth", path)]
        files = ["--instances", input.instances, *truth, "--out", output.runs]
        run_stage("workflows", "solve", *CHOICE, "--method", wildcards.method, *files, plan=plan_of())
