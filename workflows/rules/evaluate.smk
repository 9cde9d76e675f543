# Metrics from pose and ground truth: a new metric repeats no run.
rule evaluate:
    input:
        f"{VIEW}/plan/plan.parquet",
        [f"{OUT}/runs/{method}/{chunk}.parquet" for method, chunk in JOBS],
        [f"{OUT}/{kind}/{chunk.name}.npz" for chunk in PLAN.chunks for kind in ("instances", "truth")],
    output:
        f"{VIEW}/metrics/metrics.parquet",
    params:
        sources=sources("workflows/stages/evaluate.py", "workflows/metrics"),
    run:
        run_stage("workflows", "evaluate", OUT, "--plan", input[0], "--out", output[0])
