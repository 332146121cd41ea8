"""Every fault of docs/appendix/torture.md a few times; ``make torture`` does them many times.

Each function asserts by itself that nothing is lost, that what is said is one line that names the
place, and that in the end all bytes are those of an undisturbed run.
"""

import pytest

from faults import clocks, damage, full_disk, inputs, kills, places, processes, workers
from faults.bench import STAGES, Bench

pytestmark = pytest.mark.long

ARTEFACTS = ("ingest", "reduce", "sweep", "fit")


@pytest.mark.parametrize(("stage", "times"), [("ingest", 3), ("reduce", 3), ("fit", 2)])
def test_killed_at_random_moments(bench: Bench, stage: str, times: int) -> None:
    assert kills.kill(bench, stage, times).tried == times


@pytest.mark.parametrize("stage", STAGES)
def test_interrupted_at_a_random_moment(bench: Bench, stage: str) -> None:
    assert kills.interrupt(bench, stage, 1).tried == 1


def test_interrupted_while_the_libraries_load(bench: Bench) -> None:
    assert kills.loading(bench, "fit", 3).tried == 3


@pytest.mark.parametrize("stage", STAGES)
def test_no_room_for_a_write(bench: Bench, stage: str) -> None:
    assert full_disk.at_writes(bench, stage, 1).tried == 1


def test_a_small_file_system(bench: Bench) -> None:
    if not full_disk.can_mount(bench.folder):
        pytest.skip("needs the right to mount a tmpfs")
    assert full_disk.on_small_disks(bench, "reduce", 1).tried == 1


@pytest.mark.parametrize("artefact", ARTEFACTS)
@pytest.mark.parametrize("do", [damage.metadata, damage.chunks])
def test_a_flipped_bit(bench: Bench, artefact: str, do: damage.Trial) -> None:
    assert do(bench, artefact, damage.flip_a_bit, 1).tried == 1


@pytest.mark.parametrize("artefact", ["ingest", "reduce"])
def test_a_chunk_that_is_gone(bench: Bench, artefact: str) -> None:
    assert damage.chunks(bench, artefact, damage.remove, 1).tried == 1


@pytest.mark.parametrize("stage", STAGES)
def test_a_flipped_bit_in_what_a_kill_has_left(bench: Bench, stage: str) -> None:
    assert damage.unfinished(bench, stage, damage.flip_a_bit, 1).tried == 1


def test_products_that_are_damaged_are_written_again(bench: Bench) -> None:
    assert damage.products(bench, damage.flip_a_bit, 1).tried == 1


def test_several_processes_on_one_run(bench: Bench) -> None:
    assert processes.together(bench, 2).tried == 6


@pytest.mark.parametrize("stage", ["ingest", "reduce"])
@pytest.mark.parametrize("how", inputs.CHANGES)
def test_a_file_that_changes_while_it_is_read(bench: Bench, how: inputs.Change, stage: str) -> None:
    assert inputs.change(bench, how, 1, stage).tried == 1


def test_a_frame_that_rots_after_it_was_ingested(bench: Bench) -> None:
    assert inputs.rot(bench, 2).tried == 2


def test_a_clock_that_jumps(bench: Bench) -> None:
    assert clocks.jump(bench, clocks.back_an_hour).tried == 1


def test_directories_that_are_read_only(bench: Bench) -> None:
    assert places.read_only(bench).tried == 6


def test_odd_paths(bench: Bench) -> None:
    assert places.hard_names(bench, ["Übung, 夜 -'*?\n $HOME"]).tried == 1


def test_a_worker_that_dies(bench: Bench) -> None:
    with workers.cluster() as address:
        assert workers.killed(bench, address, "ingest", 1).tried == 1
        assert workers.starved(bench, address, "ingest", 1).tried == 1
