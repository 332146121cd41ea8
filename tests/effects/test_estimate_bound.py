"""An estimate that does not come to an end costs its own answer, and no more."""

from functools import partial
from typing import Any, cast

import pytest

from pixcal.engine.bounds import Bound
from pixcal.engine.run import Runtime
from pixcal.stages.diagnose import trial
from pixcal.stages.diagnose.trial import each_of, estimate

EVIDENCE = cast(Any, object())


class Endless:
    """An effect whose estimate tries again whatever happens."""

    name = "endless"

    @classmethod
    def estimate(cls, _evidence: object) -> None:
        while True:
            try:
                sum(range(10_000))
            except Exception:
                continue


class Missing:
    """One that needs frames which are not there."""

    name = "missing"

    @classmethod
    def estimate(cls, _evidence: object) -> None:
        return None


def test_it_is_not_decided_and_says_why() -> None:
    told = estimate(EVIDENCE, cast(Any, Endless), Bound(0.2))
    assert told == "not decided: the estimate exceeded its limit of 0.2 s of processor time"


@pytest.mark.parametrize("cluster", ["sync", "threads"])
def test_the_others_go_on(cluster: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trial, "OF_ESTIMATE", Bound(0.2))
    kinds = cast(Any, {kind.name: kind for kind in (Endless, Missing)})
    runtime = Runtime(cluster=cluster, workers=2, memory=1 << 50)
    found = each_of(kinds, partial(estimate, EVIDENCE), runtime, "estimate effects")
    assert found["missing"] is None
    assert str(found["endless"]).startswith("not decided")
