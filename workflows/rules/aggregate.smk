# One folder with every table that a report, a comparison or a reader needs.
rule aggregate:
    input:
        f"{VIEW}/plan/plan.parquet",
        f"{VIEW}/metrics/metrics.parquet",
        [f"{OUT}/runs/{method}/{chunk}{kind}.parquet" for method, chunk in JOBS for kind in ("", ".trace")],
    output:
        # long ones have no copy as CSV
        shown(f"{VIEW}/tables/runs.parquet", "runs", "Tables", "all runs"),
        f"{VIEW}/tables/traces.parquet",
        shown(f"{VIEW}/tables/accounting.csv", "accounting", "Tables", "planned runs and outcomes"),
        shown(f"{VIEW}/tables/provenance.json", "provenance", "Provenance", "versions and config"),
        f"{VIEW}/tables/overlays.json",
        f"{VIEW}/tables/clouds.parquet",
    params:
        config=digest(EXPERIMENT.model_dump()),
        cards=digest([registry.read_card(method.baseline).model_dump() for method in PLAN.methods]),
        sources=sources(
            "workflows/stages/aggregate.py", "workflows/stages/clouds.py", "workflows/attribution.py",
            "workflows/records.py", "workflows/outcomes.py", "workflows/labels.py",
        ),
    run:
        run_stage("workflows", "aggregate", *CHOICE, OUT, plan=PLAN)
