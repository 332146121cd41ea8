"""Share of the gap that the true effects close, with their true parameters.

They are simulated like a candidate of the diagnosis, on the same frames, against the same reference
and with the same statistics; the remainder is the least possible residual gap. This takes about as
long as the diagnosis, so it is done for a number of cases only.
"""

import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

from blind_examination.cases import effects_of
from blind_examination.draw import Truth
from pixcal.effects import effects
from pixcal.engine.run import Runtime
from pixcal.estimators.test_statistics.expectation import (
    Reference,
    expect_nominal,
    expect_with,
    signature_key,
)
from pixcal.estimators.test_statistics.gap import log_likelihood
from pixcal.model.bench import Bench
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Effect
from pixcal.stages import ingest, reduce
from pixcal.stages.diagnose.benches import CONFIRM_SIMULATIONS
from pixcal.stages.diagnose.candidates import Considered
from pixcal.stages.diagnose.comparison import Trial, differing, shrinkage
from pixcal.stages.diagnose.diagnosis_input import prepare_input
from pixcal.stages.diagnose.search_run import REFERENCES
from pixcal.stages.diagnose.trial import Trials
from pixcal.storage.manifest import read_json

EXPLAINS = 0.5  # largest share of a statistic's gap left by the true effects if they cause it


@dataclass(frozen=True)
class Oracle:
    """Effect of the true effects on the gap."""

    closed: float  # share of the gap that they close
    causes: frozenset[tuple[str, str]]  # statistics, by set, that differ because of them


def ask_oracle(
    acquisition: Path, diagnosed: Path, truth: Truth, bench: Bench, runtime: Runtime
) -> Oracle:
    """Simulate the true effects; InputError if that is not possible on the nominal bench.

    ``diagnosed``: the artefact of the case's diagnosis, whose statistics are used.
    """
    scratch = Path(tempfile.mkdtemp(prefix="pixcal-oracle-"))
    try:
        ingest.run(acquisition, scratch / "run", ingest.Config(), runtime)
        reduce.run(scratch / "run", reduce.Config(), runtime)
        signatures = _signatures(diagnosed)
        inputs = prepare_input(scratch / "run", runtime, Considered(signatures=signatures))
        trials = Trials(inputs.windows, scratch, inputs.runtime, signatures)
        true = effects_of(truth, bench)
        (nominal,) = trials.curves([()], REFERENCES, "nominal bench")
        (with_effects,) = trials.curves([true], CONFIRM_SIMULATIONS, "true effects")
        if isinstance(nominal, str) or isinstance(with_effects, str):
            raise InputError(
                f"{acquisition}: {nominal if isinstance(nominal, str) else with_effects}"
            )
        reference = Reference.of(nominal)
        data = reference.on_scale(inputs.measured)
        before, after = expect_nominal(reference), expect_with(reference, with_effects)
        start = Trial((), before, log_likelihood(data, before))
        end = Trial(true, after, log_likelihood(data, after))
        left = shrinkage(data, start, end, differing(start, end, data)).gap
        causes = frozenset(key for key in left.weights if left.left.get(key, 1.0) <= EXPLAINS)
        return Oracle(1 - left.total, causes)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _signatures(diagnosed: Path) -> tuple[type[Effect], ...]:
    """Effects whose estimates were statistics of the diagnosis."""
    names = {curve["statistic"] for curve in read_json(diagnosed / "curves.json")}
    return tuple(
        kind
        for name, kind in effects().items()
        if any(signature_key(name, domain)[0] in names for domain in kind.domains)
    )
