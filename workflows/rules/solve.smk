# The only expensive and only timed stage: one job per method and chunk, in workers that can be lost.
# `--resources timing=1` lets no two of them run beside each other, for undisturbed times.
rule solve:
    input:
        f"{OUT}/instances/{{chunk}}.npz",
    output:
        runs=f"{OUT}/runs/{{method}}/{{chunk}}.parquet",
        trace=f"{OUT}/runs/{{method}}/{{chunk}}.trace.parquet",
    params:
        identity=solve_identity,
        fingerprint=solve_fingerprint,
    resources:
        timing=1,
    shell:
        "{STAGE} solve {CHOICE} --method {wildcards.method} --instances {input}"
        " --out {output.runs}"
