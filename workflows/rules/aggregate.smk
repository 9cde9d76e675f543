# One folder with every table that a report, a comparison or a reader needs.
rule aggregate:
    input:
        f"{VIEW}/plan/plan.parquet",
        f"{VIEW}/metrics/metrics.parquet",
        [f"{OUT}/runs/{method}/{chunk}{kind}.parquet" for method, chunk in JOBS for kind in ("", ".trace")],
    output:
        [f"{VIEW}/tables/{name}.parquet" for name in ("runs", "traces")],  # long ones have no copy as CSV
        f"{VIEW}/tables/accounting.csv",
        f"{VIEW}/tables/provenance.json",
        f"{VIEW}/tables/overlays.json",
    params:
        config=digest(EXPERIMENT.model_dump()),
        cards=digest([registry.read_card(method.baseline).model_dump() for method in PLAN.methods]),
        sources=sources(
            "workflows/stages/aggregate.py", "workflows/attribution.py", "workflows/records.py",
            "workflows/outcomes.py", "workflows/labels.py",
        ),
    run:
        run_stage("workflows", "aggregate", *CHOICE, OUT)
