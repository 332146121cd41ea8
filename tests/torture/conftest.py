"""The bench that all faults are done to."""

import pytest

from faults.bench import Bench, make_bench


@pytest.fixture(scope="session")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    """An acquisition on four uneven tiles, and what undisturbed commands make of it."""
    return make_bench(tmp_path_factory.mktemp("torture"), seed=7)
