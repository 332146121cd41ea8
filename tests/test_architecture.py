"""The code's real imports, held against the table in docs/explanation/architecture.md."""

import ast
import graphlib
import re
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = {
    "pixcal": ROOT / "pipeline/pixcal",
    "blind_examination": ROOT / "bench/blind_examination",
    "pixcal_cli": ROOT / "cli/pixcal_cli",
}
NEW_RANDOM = {"Generator", "default_rng", "SeedSequence", "BitGenerator", "PCG64", "Philox"}
PAGE = (ROOT / "docs/explanation/architecture.md").read_text(encoding="utf-8")


def table() -> dict[str, tuple[str, str]]:
    """Folder -> (what it holds, what it may import), as the page says."""
    rows = {}
    for line in PAGE.splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        folder = re.fullmatch(r"`([\w/]+)/`", cells[0])
        if folder and len(cells) == 3:
            rows[folder[1].split("/")[-1]] = (cells[1], cells[2])
    return rows


def allowed(folder: str) -> set[str]:
    rows = list(table())
    text = table()[folder][1]
    if text == "nothing of the project":
        return set()
    if text == "all of the above":
        return set(rows[: rows.index(folder)])
    names = set(re.findall(r"`(\w+)`", text))
    assert names, f"{folder}: what it may import is not said"
    assert re.fullmatch(r"(`\w+`(, )?)+", text), f"{folder}: {text!r} is not a list of folders"
    return names


def exclusive() -> dict[str, str]:
    """Library -> the one folder that may import it, as the page says."""
    owners: dict[str, str] = {}
    for folder, (holds, _) in table().items():
        _, _, only = holds.partition("the only importer of ")
        owners |= dict.fromkeys(re.findall(r"[\w.]+", only.replace(" and ", " ")), folder)
    return owners


def modules() -> dict[str, Path]:
    found = {}
    for package, folder in PACKAGES.items():
        for file in folder.rglob("*.py"):
            parts = file.relative_to(folder).with_suffix("").parts
            found[".".join([package, *(p for p in parts if p != "__init__")])] = file
    return found


MODULES = modules()


def folder_of(module: str) -> str:
    """Row of the table that a module belongs to; '' for the package ``pixcal`` itself."""
    parts = module.split(".")
    return parts[0] if parts[0] != "pixcal" else parts[1] if len(parts) > 1 else ""


FOLDERS = sorted({folder_of(module) for module in MODULES})
EVERY_FOLDER = pytest.mark.parametrize("folder", FOLDERS)


def modules_in(folder: str) -> list[str]:
    return sorted(module for module in MODULES if folder_of(module) == folder)


@cache
def syntax(file: Path) -> ast.Module:
    return ast.parse(file.read_text(encoding="utf-8"))


def imports(module: str) -> Iterator[str]:
    """Dotted names that a module imports, anywhere in its text."""
    for node in ast.walk(syntax(MODULES[module])):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: imports are absolute"
            yield from (f"{node.module}.{name.name}" for name in node.names)


def own_imports(module: str) -> set[str]:
    """Modules of the project that a module imports."""
    found = set()
    for name in imports(module):
        if name.split(".")[0] in PACKAGES:
            while name not in MODULES:
                name = name.rpartition(".")[0]
            found.add(name)
    return found - {module}


def test_the_page_lists_the_folders_that_there_are() -> None:
    there = {f.name for f in PACKAGES["pixcal"].iterdir() if (f / "__init__.py").exists()}
    assert set(table()) == there | set(PACKAGES) - {"pixcal"}
    assert {"zarr", "astropy.io", "dask", "rich", "matplotlib", "jinja2"} <= set(exclusive())


@EVERY_FOLDER
def test_modules_import_only_what_their_folder_may(folder: str) -> None:
    may = allowed(folder) | {folder, ""} if folder else set()  # the package itself: nothing of ours
    for module in modules_in(folder):
        used = {folder_of(name) for name in own_imports(module)}
        assert used <= may, f"{module} imports {used - may}"


@EVERY_FOLDER
def test_libraries_stay_in_their_folders(folder: str) -> None:
    owners = exclusive()
    owners["distributed"] = owners["dask"]
    for module in modules_in(folder):
        for name in imports(module):
            for library, owner in owners.items():
                if name == library or name.startswith(f"{library}."):
                    assert folder == owner, f"{module}: {name} belongs in {owner}/"


EFFECTS = {file.stem for file in (PACKAGES["pixcal"] / "effects").glob("[!_]*.py")}
NAMED = {
    "blind_examination.strengths": EFFECTS,  # What the examination asks of each.
    # Terms of a budget, as the next ones.
    "pixcal.stages.budget.stage": {"quantisation"},
    "pixcal.stages.budget.calibration": {"flat_error"},
    "pixcal_cli.budget": {"flat_error"},
    "pixcal.stages.reduce.fringe_sets": {"quantisation"},
    "pixcal.stages.reduce.reduction": {"quantisation"},
    "pixcal.report.tables": {"quantisation"},
}
"""Names of effects outside their files."""


@EVERY_FOLDER
def test_no_effect_is_a_special_case_outside_its_file(folder: str) -> None:
    for module in modules_in(folder):
        if module.startswith("pixcal.effects."):
            continue
        words = {n.value for n in ast.walk(syntax(MODULES[module])) if isinstance(n, ast.Constant)}
        assert not (words & EFFECTS) - NAMED.get(module, set()), module
        if module not in NAMED:
            own = own_imports(module) & {f"pixcal.effects.{name}" for name in EFFECTS}
            assert not own, module


def test_no_module_imports_itself_in_a_circle() -> None:
    graph = {module: own_imports(module) for module in MODULES}
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        circle = error.args[1]
        pytest.fail(" -> ".join(circle))


MOST_MODULE_LINES = 300
LONG_MODULES = {
    "pixcal.model.options": "every option of every command, defined once",
    "pixcal.kernels.bilinear": "one file, so that Numba's cache notices changes",
    "pixcal.stages.diagnose.search": "one search, whose steps share what it has tried",
    "pixcal.estimators.fringe_fit.scout": "one class: the steps to the frames of a set",
    "pixcal.estimators.detector.code_density": "widths of codes and the weights that explain them",
    "pixcal.effects.lag": "several kinds of traps, each with its parameters",
}
"""Modules of more than `MOST_MODULE_LINES`, and why."""


@EVERY_FOLDER
def test_modules_are_short(folder: str) -> None:
    for module in modules_in(folder):
        lines = len(MODULES[module].read_text(encoding="utf-8").splitlines())
        assert (lines > MOST_MODULE_LINES) == (module in LONG_MODULES), f"{module}: {lines} lines"


SAME_NAME = {"Run"}  # the options of `pixcal run`, and an opened run directory
"""Classes that two modules may define."""


def test_class_names_are_unique() -> None:
    """A reader who looks for a class finds one."""
    names: Counter[str] = Counter()
    for file in MODULES.values():
        classes = (node for node in ast.walk(syntax(file)) if isinstance(node, ast.ClassDef))
        names.update(node.name for node in classes)
    assert {name for name, count in names.items() if count > 1} == SAME_NAME


MOST_LINES, MOST_PARAMETERS = 60, 7
LONG = {
    "pixcal.api.arrays.calibrate": "signature and docstring document every option",
    "pixcal.kernels.bilinear.sweep_batches": "forty lines describe the arrays it works on",
}
"""Functions of more than `MOST_LINES`, and why."""
MANY_PARAMETERS = {
    "pixcal.api.arrays.calibrate": "public: one for every input and option",
    "pixcal.storage.stage.make": "named options that most stages leave out",
    "pixcal.report.drawing.axes_grid": "named margins, most left at their defaults",
    "pixcal.estimators.detector.pair_noise.flat_pair_sums": "noise and limits of samples",
}
"""Functions of more than `MOST_PARAMETERS`, and why."""


def functions(module: str) -> Iterator[ast.FunctionDef]:
    for node in ast.walk(syntax(MODULES[module])):
        if isinstance(node, ast.FunctionDef):
            yield node


def parameters(function: ast.FunctionDef) -> int:
    """Without ``self`` and ``cls``; zero of compiled functions, which take plain arrays."""
    if any(ast.unparse(d).startswith(("kernel(", "inner(")) for d in function.decorator_list):
        return 0
    names = [arg.arg for arg in (*function.args.posonlyargs, *function.args.args)]
    return len(names) + len(function.args.kwonlyargs) - (names[:1] in (["self"], ["cls"]))


@EVERY_FOLDER
def test_functions_are_short_and_take_few_parameters(folder: str) -> None:
    for module in modules_in(folder) if folder not in PACKAGES else []:
        for one in functions(module):
            assert one.end_lineno is not None
            name, lines = f"{module}.{one.name}", one.end_lineno - one.lineno + 1
            long = lines > MOST_LINES
            assert long == (name in LONG), f"{name}: {lines} lines"
            many = folder != "kernels" and parameters(one) > MOST_PARAMETERS
            assert many == (name in MANY_PARAMETERS), f"{name}: {parameters(one)} parameters"


@EVERY_FOLDER
def test_random_numbers_come_from_a_generator(folder: str) -> None:
    for module in modules_in(folder):
        assert "random" not in set(imports(module)), f"{module}: the library's global generator"
        for node in ast.walk(syntax(MODULES[module])):
            if isinstance(node, ast.Attribute) and ast.unparse(node.value) in (
                "np.random",
                "numpy.random",
            ):
                assert node.attr in NEW_RANDOM, f"{module}, line {node.lineno}: global {node.attr}"
        for name in imports(module):
            if name.startswith("numpy.random."):
                assert name.rpartition(".")[2] in NEW_RANDOM, f"{module}: {name}"


@pytest.mark.parametrize(
    ("line", "rule"),
    [
        ("from pixcal.storage import cube", test_modules_import_only_what_their_folder_may),
        ("def f():\n    import pixcal_cli", test_modules_import_only_what_their_folder_may),
        ("from astropy import io", test_libraries_stay_in_their_folders),
        ("import astropy.io.fits", test_libraries_stay_in_their_folders),
        ("from distributed import Client", test_libraries_stay_in_their_folders),
        ("np.random.seed(1)", test_random_numbers_come_from_a_generator),
        ("from numpy.random import rand", test_random_numbers_come_from_a_generator),
        (302 * "\n", test_modules_are_short),
        ("def f(a, b, c, d, e, f, g, h): ...", test_functions_are_short_and_take_few_parameters),
        ("def f():" + 60 * "\n    pass", test_functions_are_short_and_take_few_parameters),
    ],
)
def test_a_breach_is_caught(
    line: str, rule: Callable[[str], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "breach.py"
    file.write_text(line)
    monkeypatch.setitem(MODULES, "pixcal.model.breach", file)
    with pytest.raises(AssertionError):
        rule("model")


def test_a_circle_is_caught(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, other in (("one", "two"), ("two", "one")):
        file = tmp_path / f"{name}.py"
        file.write_text(f"def f():\n    from pixcal.model import {other}\n")
        monkeypatch.setitem(MODULES, f"pixcal.model.{name}", file)
    with pytest.raises(pytest.fail.Exception, match="one"):
        test_no_module_imports_itself_in_a_circle()
