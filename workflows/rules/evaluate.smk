from data import registry as data_registry
from dcreg.plugins import files_of, plugins
from workflows.hashing import digest_paths


# Metrics from pose and ground truth: a new metric repeats no run.
def added_metrics():
    return digest_paths([path for plugin in plugins("dcreg.metrics") for path in files_of(plugin)], Path())


DATASETS = sorted({entry.dataset for entry in EXPERIMENT.datasets})


rule evaluate:
    input:
        f"{VIEW}/plan/plan.parquet",
        [f"{OUT}/runs/{method}/{chunk}.parquet" for method, chunk in JOBS],
        [f"{OUT}/{kind}/{chunk.name}.npz" for chunk in PLAN.chunks for kind in ("instances", "truth")],
    output:
        f"{VIEW}/metrics/metrics.parquet",
    params:
        sources=sources("workflows/stages/evaluate.py", "workflows/metrics"),
        added=added_metrics(),
        limits=digest({name: data_registry.dataset(name).card.success_limits for name in DATASETS}),
    run:
        run_stage("workflows", "evaluate", OUT, "--plan", input[0], "--out", output[0])
