"""The study of power counts what was named, and what was named wrongly."""

from pathlib import Path

import yaml

import power
import study
from pixcal.model.bench import load_bench


def test_the_table_counts_effects_named_and_false_causes() -> None:
    results = [
        {
            "effect": "lag",
            "strength": 3.0,
            "draw": d,
            "verdict": "explained",
            "causes": causes,
            "sigmas": 5.0 + d,
        }
        for d, causes in enumerate((["lag"], [], ["lag", "ipc"]))
    ]
    results += [
        {"effect": "", "strength": 0.0, "draw": d, "verdict": v, "causes": [], "sigmas": None}
        for d, v in enumerate(("no gap", "unexplained"))
    ]
    _, _, lag, none = power.table(results).splitlines()
    assert lag == "| lag | – | – | 2 of 3 (6.0 σ) | – | 1 of 3 |"
    assert none == "| none | a gap in 1 of 2 |  |  |  | 0 of 2 |"


def test_a_bench_of_the_study_is_a_bench_file(tmp_path: Path) -> None:
    (tmp_path / "bench.yaml").write_text(yaml.safe_dump(study.bench(7)))
    bench = load_bench(tmp_path / "bench.yaml")
    assert [one.count for one in bench.frames.fringes] == [300, 300]
