# One folder with every table the report, a comparison or a reader needs.
rule aggregate:
    input:
        f"{OUT}/plan/plan.parquet",
        f"{OUT}/metrics/metrics.parquet",
        [f"{OUT}/runs/{method}/{chunk}{kind}.parquet" for method, chunk in JOBS for kind in ("", ".trace")],
    output:
        [f"{OUT}/tables/{name}.{kind}" for name in ("runs", "traces") for kind in ("parquet", "csv")],
        f"{OUT}/tables/accounting.csv",
        f"{OUT}/tables/provenance.json",
        f"{OUT}/tables/overlays.json",
    params:
        config=digest(EXPERIMENT.model_dump()),
        cards=digest([methods.card(method.baseline).model_dump() for method in PLAN.methods]),
        sources=sources(
            "workflows/stages/aggregate.py", "workflows/attribution.py", "workflows/records.py"
        ),
    shell:
        "{STAGE} aggregate {CHOICE} {OUT}"
