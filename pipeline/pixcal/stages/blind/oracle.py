"""What the true effects, with their true parameters, close of the gap.

They are simulated as a candidate of the diagnosis is, on the same frames and against the same
reference; what then is left is the share that nobody could do better than.
"""

import shutil
import tempfile
from pathlib import Path

from pixcal.engine.run import Runtime
from pixcal.estimators.gap import Reference, expect_nominal, expect_with, log_likelihood
from pixcal.model.bench import Bench
from pixcal.model.errors import InputError
from pixcal.stages import ingest, reduce
from pixcal.stages.blind.cases import effects_of
from pixcal.stages.blind.draw import Truth
from pixcal.stages.diagnose.search import CONFIRM, Trial, differing, shrinkage
from pixcal.stages.diagnose.stage import REFERENCES, look_at
from pixcal.stages.diagnose.trial import Trials


def share_closed(acquisition: Path, truth: Truth, bench: Bench, runtime: Runtime) -> float:
    """Share of the gap that the true effects close.

    Parameters
    ----------
    acquisition : Path
        Of the case.
    truth : Truth
        Of the library's own effects.
    bench : Bench
        Of the case.
    runtime : Runtime

    Raises
    ------
    InputError
        If the effects cannot be simulated on the nominal bench.
    """
    scratch = Path(tempfile.mkdtemp(prefix="pixcal-oracle-"))
    try:
        ingest.run(acquisition, scratch / "run", ingest.Config(), runtime)
        reduce.run(scratch / "run", reduce.Config(), runtime)
        look = look_at(scratch / "run", scratch, runtime)
        trials = Trials(look.windows, scratch, look.runtime)
        effects = effects_of(truth, bench)
        (nominal,) = trials.curves([()], REFERENCES, "nominal bench")
        (with_effects,) = trials.curves([effects], CONFIRM, "true effects")
        if isinstance(nominal, str) or isinstance(with_effects, str):
            raise InputError(
                f"{acquisition}: {nominal if isinstance(nominal, str) else with_effects}"
            )
        reference = Reference.of(nominal)
        data = reference.on_scale(look.measured)
        before, after = expect_nominal(reference), expect_with(reference, with_effects)
        start = Trial((), before, log_likelihood(data, before))
        end = Trial(effects, after, log_likelihood(data, after))
        where = differing(start, end, data)
        return 1 - shrinkage(data, start, end, where).gap.total
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
