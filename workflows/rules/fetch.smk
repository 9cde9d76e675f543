# Brings in the files of a dataset that this experiment needs, verified.
def fetch_cards(wildcards):
    return sources(f"data/{wildcards.dataset}")


rule fetch:
    output:
        f"{OUT}/fetched/{{dataset}}.json",
    params:
        cards=fetch_cards,
        chunks=[chunk.name for chunk in PLAN.chunks],
    shell:
        "{STAGE} fetch {CHOICE} --dataset {wildcards.dataset} --out {output}"
