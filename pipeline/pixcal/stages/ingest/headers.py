"""Check the headers of all files before any samples are read."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pixcal.engine.run import Runtime, run_tasks
from pixcal.model.acquisition import Acquisition
from pixcal.model.errors import InputError
from pixcal.storage.frame_file import FrameFile
from pixcal.storage.frames import Frame, inspect, tabulate
from pixcal.storage.sources import SourceFile

_DTYPES = tuple(map(np.dtype, ("u1", "i1", "u2", "i2", "u4", "i4", "f4")))
_FILES_A_TASK = 32


def check_headers(
    described: Acquisition,
    sources: Mapping[str, Sequence[SourceFile]],
    known: Mapping[str, list[FrameFile]],
    runtime: Runtime,
) -> tuple[dict[str, list[Frame]], list[str]]:
    """Headers of the files of arrays not ``known``: table of frames of each array, warnings."""
    unknown = {array: files for array, files in sources.items() if array not in known}
    listed = [source for files in unknown.values() for source in files]
    batches = [listed[n : n + _FILES_A_TASK] for n in range(0, len(listed), _FILES_A_TASK)]
    results = run_tasks(_inspect_batch, batches, runtime, label="headers")
    answers = [answer for batch in results for answer in batch]
    problems = [answer for answer in answers if isinstance(answer, str)]
    if problems:
        more = f" ({len(problems) - 1} more bad files)" if len(problems) > 1 else ""
        raise InputError(problems[0] + more)
    files = iter(answer for answer in answers if isinstance(answer, FrameFile))
    read = {array: [next(files) for _ in its_files] for array, its_files in unknown.items()}
    by_array = {array: known[array] if array in known else read[array] for array in sources}
    _check_shapes(by_array)
    for array, its_files in read.items():
        common_dtype(array, its_files)
    tables, warnings = {}, []
    for array, its_files in by_array.items():
        frames, odd = tabulate(array, its_files, described.fibres.frame_period_s)
        tables[array] = frames
        warnings += odd
    return tables, warnings


def _inspect_batch(batch: Sequence[SourceFile]) -> list[FrameFile | str]:
    """Description of each file, or its error."""
    answers: list[FrameFile | str] = []
    for source in batch:
        try:
            answers.append(inspect(source))
        except InputError as error:
            answers.append(str(error))
    return answers


def _check_shapes(by_array: Mapping[str, Sequence[FrameFile]]) -> None:
    """Refuse frames whose size differs from that of most files."""
    files = [file for its_files in by_array.values() for file in its_files]
    usual = Counter(file.shape[1:] for file in files).most_common(1)[0][0]
    odd = next((file for file in files if file.shape[1:] != usual), None)
    if odd is not None:
        other = next(file for file in files if file.shape[1:] == usual)
        sizes = [f"{nx} × {ny}" for ny, nx in (odd.shape[1:], usual)]
        raise InputError(
            f"{odd.source.path}: frames of {sizes[0]} pixels (x × y), where those of "
            f"{other.source.name} and of most files have {sizes[1]}; all frames of an acquisition "
            "must have the same size"
        )


def common_dtype(array: str, files: Sequence[FrameFile]) -> np.dtype[Any]:
    """Smallest type that holds the samples of all files of an array."""
    first: dict[np.dtype[Any], FrameFile] = {}
    for file in files:
        first.setdefault(file.coding.dtype, file)
    dtype = np.result_type(*first)
    if dtype not in _DTYPES:
        a, *_, b = first.items()
        raise InputError(
            f"{b[1].source.path}: {b[0]} samples, where {a[1].source.name} of the same array "
            f"{array} has {a[0]}; no 32-bit type holds both, convert one"
        )
    return dtype
