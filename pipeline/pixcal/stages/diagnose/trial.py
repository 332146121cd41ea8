"""Simulations of the analysed windows, processed by the same stages as the data."""

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from operator import call
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from pixcal.engine.bounds import Bound, Exceeded
from pixcal.engine.run import Runtime, run_tasks
from pixcal.estimators.diagnosis.evidence import Evidence, Level
from pixcal.estimators.test_statistics import Curve, Key, measure
from pixcal.estimators.test_statistics.expectation import signature_curve, signature_key
from pixcal.model.config import to_plain
from pixcal.model.errors import DamagedError, InputError
from pixcal.simulation.effect import Again, Effect, Estimate
from pixcal.stages.diagnose.nominal import NominalBench
from pixcal.stages.diagnose.parts import FrameSubset, evidence_of
from pixcal.stages.tiles import Part
from pixcal.storage.manifest import digest, read_json, write_json

# the slowest so far took 16 s: telegraph noise of 40,000 pixels with different read noise
OF_ESTIMATE = Bound(seconds=45.0)

_SLOW = threading.Lock()

K = TypeVar("K")
T = TypeVar("T")
Curves = dict[Key, Curve]
# an effect whose estimate is a statistic; or the score test of one effect by its forward model
Signature = type[Effect] | Again
Effects = tuple[Effect, ...]


@dataclass(frozen=True)
class Window:
    """A part of the detector to analyse."""

    part: Part  # rows and columns
    bench: NominalBench  # measured in this window
    learn: FrameSubset  # learn, test: frames to which effects are fitted, and held-out frames
    test: FrameSubset
    whole: tuple[int, int]  # rows and columns of the detector's window
    # added to the seeds of simulations: each acquisition is compared with different random numbers,
    # so that chance does not act equally on all of them
    seed: int = 0
    full: frozenset[Level] = frozenset()  # flats that saturate

    def evidence(
        self, half: FrameSubset, effects: Effects, seed: int, *, number: int = 0
    ) -> Evidence:
        """Evidence of a simulated half of the frames with effects (`NominalBench.simulate`)."""
        of_window = self.seed + seed
        raw = self.bench.simulate(half, effects, of_window, window=number)
        return replace(evidence_of(raw, self.part, self.whole), full=self.full)


@dataclass(frozen=True)
class Trials:
    """Simulations of the test frames of all windows; none is made twice."""

    windows: tuple[Window, ...]
    scratch: Path  # folder for intermediate files; a resumed run finds its simulations there
    runtime: Runtime
    signatures: tuple[Signature, ...] = ()  # effects whose estimates are also statistics
    # estimates by name of the effect: from the seed ``exact`` on, parameters are drawn within their
    # errors, so that the scatter of the simulations includes these errors
    estimates: Mapping[str, Estimate] = field(default_factory=dict)
    exact: int = 0
    _made: dict[tuple[frozenset[Effect], int], list[Curves] | str] = field(default_factory=dict)

    @property
    def samples(self) -> int:
        """Number of samples of a simulation, all windows together."""
        return sum(
            math.prod(last - first for first, last in window.part)
            * sum(len(frames) for frames in window.test.values())
            for window in self.windows
        )

    def curves(
        self,
        benches: Sequence[Effects],
        seeds: int,
        label: str,
        beside: Callable[[], None] | None = None,
    ) -> list[list[Curves] | str]:
        """Simulations of each bench (means over the windows), or why it has none.

        ``seeds``: simulations of each. ``beside``: run in this process meanwhile, if any is made.
        """
        wanted = [(frozenset(bench), seed) for bench in benches for seed in range(seeds)]
        missing = [one for one in dict.fromkeys(wanted) if one not in self._made]
        places = range(len(self.windows))
        items = [(tuple(bench), seed, n) for bench, seed in missing for n in places]
        if items:
            results = self._simulated(items, label, beside)
            for number, one in enumerate(missing):
                of_windows = results[number * len(places) : (number + 1) * len(places)]
                wrong = [r for r in of_windows if isinstance(r, str)]
                kept = [r for r in of_windows if not isinstance(r, str)]
                self._made[one] = wrong[0] if wrong else kept
        curves: list[list[Curves] | str] = []
        for bench in benches:
            made = [self._made[frozenset(bench), seed] for seed in range(seeds)]
            wrong = [r for r in made if isinstance(r, str)]
            right = [averaged(r) for r in made if not isinstance(r, str)]
            curves.append(wrong[0] if wrong else right)
        return curves

    def _simulated(
        self,
        items: Sequence[tuple[Effects, int, int]],
        label: str,
        beside: Callable[[], None] | None,
    ) -> list[Any]:
        work = partial(_kept_or_made, self.windows, self.scratch, self.signatures)
        moved = [(self._moved(effects, seed), seed, n) for effects, seed, n in items]
        if beside is None:
            results = run_tasks(work, moved, self.runtime, label=label)
        else:
            others: list[Callable[[], Any]] = [partial(work, item) for item in moved]
            _, *results = run_tasks(call, [beside, *others], self.runtime.here, label=label)
        # A bench refused with drawn parameters may work with the estimated ones.
        again = [
            n
            for n, (one, other) in enumerate(zip(moved, items, strict=True))
            if isinstance(results[n], str) and one != other
        ]
        if again:
            exact = run_tasks(work, [items[n] for n in again], self.runtime, label=label)
            for n, result in zip(again, exact, strict=True):
                results[n] = result
        return results

    def _moved(self, effects: Effects, seed: int) -> Effects:
        known = self.estimates if seed >= self.exact else {}
        return tuple(known[e.name].scattered(e, seed) if e.name in known else e for e in effects)

    def of_window(self, number: int, bench: Effects, seeds: int) -> list[Curves]:
        """Statistics of one window, of a bench that `curves` has simulated."""
        made = [self._made[frozenset(bench), seed] for seed in range(seeds)]
        return [r[number] for r in made if not isinstance(r, str)]


def _kept_or_made(
    windows: tuple[Window, ...],
    scratch: Path,
    signatures: tuple[Signature, ...],
    item: tuple[Effects, int, int],
) -> Curves | str:
    """A simulation from an interrupted run, or a new one."""
    effects, seed, number = item
    on = sorted((e.name, to_plain(e)) for e in effects)
    name = digest(on, seed, number, windows[number].part, sorted(k.name for k in signatures))
    file = scratch / f"{name}.json"
    plain = _kept(file)
    if plain is not None:
        if "curves" not in plain:
            return str(plain["refused"])
        return {
            (key, of): Curve(np.array(x, float), np.array(value, float))
            for key, of, x, value in plain["curves"]
        }
    made = _made(windows, signatures, item)
    if isinstance(made, str):
        plain = {"refused": made}
    else:
        plain = {"curves": [[*key, c.x.tolist(), c.value.tolist()] for key, c in made.items()]}
    write_json(file, plain | {"seal": digest(plain)})
    return made


def _kept(file: Path) -> dict[str, Any] | None:
    """Contents of a file of an interrupted run, if it is undamaged."""
    try:
        plain: dict[str, Any] = read_json(file)
        return plain if plain.pop("seal") == digest(plain) else None
    except (DamagedError, AttributeError, KeyError):
        return None


def _made(
    windows: tuple[Window, ...], signatures: tuple[Signature, ...], item: tuple[Effects, int, int]
) -> Curves | str:
    effects, seed, number = item
    window = windows[number]
    try:
        evidence = window.evidence(window.test, effects, seed, number=number)
        return measured_curves(evidence, signatures)
    except InputError as error:
        return str(error)


def measured_curves(evidence: Evidence, signatures: Sequence[Signature]) -> Curves:
    """The test statistics, and the detection significance of given effects."""
    curves = measure(evidence)
    for kind in signatures:
        significance = detect(evidence, kind)
        if significance is not None:
            curves[signature_key(kind.name, kind.domains[0])] = signature_curve(significance)
    return curves


def averaged(curves: Sequence[Curves]) -> Curves:
    """Mean over windows of the curves that all windows have."""
    first, *others = curves
    if not others:
        return first
    means = {}
    for key, curve in first.items():
        alike = [curve, *(c[key] for c in others if key in c)]
        if len(alike) == len(curves) and len({len(c.value) for c in alike}) == 1:
            means[key] = Curve(curve.x, np.mean([c.value for c in alike], axis=0))
    return means


def estimate(
    evidence: Evidence, kind: type[Effect], bound: Bound = OF_ESTIMATE
) -> Estimate | str | None:
    """Parameters of an effect; None without evidence, a sentence where the estimate failed."""
    answer = _kept_within(bound, kind.estimate, evidence)
    if isinstance(answer, Estimate) and not np.isfinite(answer.significance):
        return "cannot be estimated here: no finite significance"
    return answer


def detect(evidence: Evidence, kind: Signature, bound: Bound = OF_ESTIMATE) -> float | None:
    """Significance of an effect; None if it cannot be determined."""
    # Slow detections run one at a time: the memory plan of simulations allows for one only.
    with nullcontext() if kind.quick else _SLOW:
        significance = _kept_within(bound, kind.detect, evidence)
    return significance if isinstance(significance, float) and np.isfinite(significance) else None


def each_of(
    kinds: Mapping[str, K], ask: Callable[..., T], runtime: Runtime, label: str
) -> dict[str, T]:
    """Result of ``ask`` for each effect, by its name."""
    bound = replace(OF_ESTIMATE, memory=runtime.memory, excluded_bytes=runtime.excluded_bytes)
    asked = partial(ask, bound=bound)
    results = run_tasks(asked, list(kinds.values()), runtime.here, label=label)
    return dict(zip(kinds, results, strict=True))


def _kept_within(bound: Bound, ask: Callable[[Evidence], T], evidence: Evidence) -> T | str:
    """Result of ``ask`` within a bound, or why there is none."""
    try:
        with bound.enforced():
            return ask(evidence)
    except Exceeded:
        return f"not decided: the estimate exceeded its limit of {bound.describe()}"
    except NotImplementedError as error:
        return str(error)
    except np.linalg.LinAlgError:
        return "cannot be estimated here: these frames do not determine its parameters"
    except (InputError, ValueError, ArithmeticError) as error:
        text = str(error)
        reason = text if text.startswith("not decided") else f"cannot be estimated here: {text}"
        return " ".join(reason.split())[:300]
