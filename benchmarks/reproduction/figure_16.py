"""Figures 16 and 17: paths of crests and valleys over the whole detector, and their cost map."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from pixcal.kernels.optics import Geometry
from pixcal.kernels.scene import geometry
from pixcal.report.text import number
from pixcal.storage.manifest import read_json
from reproduction.lab import Lab, Scene
from reproduction.outcome import Outcome, Row


@dataclass(frozen=True)
class Paths:
    """Fibre positions from the crests of a set."""

    facts: dict[str, Any]  # the set's part of ``crests.json``
    truth: Geometry
    picture: bytes  # PNG

    def value(self, name: str) -> tuple[float, float, float]:
        """A parameter of the geometry as fitted, its error, and its truth, mm."""
        found = self.facts["geometry"]
        return found[f"{name}_mm"], found[f"{name}_sigma_mm"], getattr(self.truth, name)

    @property
    def ratio_error(self) -> float:
        """Relative error of B/D."""
        baseline, distance = self.value("baseline_x"), self.value("distance")
        return float(baseline[0] / distance[0] / (baseline[2] / distance[2]) - 1)


def measure(scene: Scene, frames: int = 1) -> Paths:
    """Follow the crests of the first set."""
    name = scene.bench.frames.fringes[0].name
    run = scene.crests(frames)
    facts = read_json(run / "products" / "crests.json")["sets"][name]
    picture = (run / "products" / f"crests-{name}.png").read_bytes()
    return Paths(facts, geometry(scene.bench, 0), picture)


def make(lab: Lab) -> Outcome:
    """Simulate one frame of the whole detector and follow its crests."""
    bench = lab.bench("figure-16")
    found = measure(lab.scene("figure-16", bench))
    distance, baseline = found.value("distance"), found.value("baseline_x")
    alone = abs(distance[0] / distance[2] - 1)
    ny, nx = bench.detector.shape
    facts = found.facts
    return Outcome(
        figure="16-17",
        title="Paths of crests and valleys, and their cost",
        run=f"One noise-free frame of {number(nx)} × {number(ny)} px, the size of the paper; the "
        f"fit starts from a distance of {number(bench.optics.nominal_distance_mm, 4)} mm.",
        caption="Above: the outermost paths, stretched, and all paths with the fibres. Middle: "
        "details of the frame, and the scatter of the points. Below: the cost of equation 7 over "
        "distance and baseline, over distance and their ratio, and along the valley.",
        rows=(
            Row(
                "paths followed",
                f"{number(facts['paths'])}, with {number(facts['points_used'])} points",
                "paths",
            ),
            Row(
                "single minimum within the maps",
                "yes" if facts["unique_minimum"] else "no",
                "minimum",
            ),
            Row("distance D", _apart(*distance), "accurate"),
            Row("baseline B", _apart(*baseline), "accurate"),
            Row(
                "relative error of D, and of B/D",
                f"{number(alone, 2)} and {number(abs(found.ratio_error), 2)}",
                "correlated",
            ),
            Row("evaluations of the model", number(facts["evaluations"])),
        ),
        difference="None. The fit uses the nominal values of the bench as weak priors and also "
        "frees the tilt of the baseline.",
        numbers={
            "geometry": facts["geometry"],
            "paths": facts["paths"],
            "points": facts["points"],
            "points_used": facts["points_used"],
            "unique_minimum": facts["unique_minimum"],
            "cost_rad2": facts["cost_rad2"],
            "relative_error_of_distance": float(alone),
            "relative_error_of_ratio": found.ratio_error,
            "point_sigma_median_px": facts["point_sigma_median_px"],
            "residual_of_distance_sigma": float(
                (distance[0] - distance[2]) / np.maximum(distance[1], 1e-300)
            ),
        },
        picture=found.picture,
    )


def _apart(value: float, sigma: float, true: float) -> str:
    return f"error {number(value - true, 2)} mm of {number(true)}, sigma {number(sigma, 2)} mm"
