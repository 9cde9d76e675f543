# From experiment to report:
#   snakemake --cores 2 --force-use-threads --scheduler greedy --config experiment=demo
# `python -m workflows run demo` does the same, with checks before it and a summary after it.
#
# results/<experiment>/   plan/ instances/ truth/ runs/ metrics/ tables/ report/
#   parts/<selection>/    plan/ metrics/ tables/ report/ of a part; instances and runs are shared
# workflows/records.py describes the tables.

from snakemake.utils import min_version

min_version("9.6")

include: "workflows/rules/common.smk"

report: "workflows/captions/workflow.rst"  # of `snakemake --report`, see workflows/rules/common.smk

# Snakemake's timers for its rate of jobs would delay its end by a second.
onsuccess:
    cancel_timers()

onerror:
    cancel_timers()

rule all:
    input:
        f"{VIEW}/report/index.html",

include: "workflows/rules/plan.smk"
include: "workflows/rules/fetch.smk"
include: "workflows/rules/generate.smk"
include: "workflows/rules/solve.smk"
include: "workflows/rules/evaluate.smk"
include: "workflows/rules/aggregate.smk"
include: "workflows/rules/report.smk"
include: "workflows/rules/compare.smk"

# Everything except the report.
rule tables:
    input:
        rules.aggregate.output,
