rule plan:
    output:
        f"{VIEW}/plan/plan.parquet",
    params:
        plan=digest([EXPERIMENT.model_dump(), PLAN.selection.model_dump(), PLAN.needs and PLAN.needs.trials]),
        sources=sources("workflows/stages/plan.py", "workflows/records.py"),
    run:
        run_stage("workflows", "plan", *CHOICE, "--out", output[0], plan=PLAN)
