"""Faulty files with the user's own effects, given to simulate."""

import numpy as np
from astropy.io import fits

from fuzzing.laws import RUNTIME, Broken, Case, Kind, pixcal
from fuzzing.settings import small_bench

GOOD = '''
from dataclasses import dataclass
from pixcal.model.config import quantity
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Effect, Stage

@dataclass(frozen=True)
class Glow(Effect):
    """Light of the amplifier."""

    name, title, acts_at = "glow", "amplifier glow", Stage.LIGHT
    domains, strengths, sources = ("intensity",), ("electrons",), ("a guess, to be measured",)
    electrons: float = quantity(100.0, unit="e-", low=0, doc="in every pixel")

    def photons(self, mean, shot):
        return mean + self.electrons
'''
BODY = "return mean + self.electrons"
STEP = "def photons"
CHANGES = (
    ("", ""),
    (BODY, "raise ValueError('two\\nlines')"),
    (BODY, "raise InputError('glow: too bright; dim it')"),
    (BODY, "return None"),
    (BODY, "return mean[:1]"),
    (BODY, "return mean.astype(complex)"),
    (BODY, "return 'light'"),
    (BODY, "return mean + float('nan')"),
    (BODY, "return mean - 1e9"),
    (BODY, "return mean * 1e300"),
    (BODY, "return 1 / 0"),
    (BODY, "return self.photons(mean, shot)"),
    (BODY, "return mean.reshape(-1)"),
    (BODY, "raise SystemExit(3)"),
    (BODY, "return [mean]"),
    (BODY, "mean += 1e5; return mean"),
    (BODY, "return mean.astype('f8')"),
    (BODY, "assert False"),
    (BODY, "raise KeyError('x')"),
    (BODY, "return mean[::-1, ::-1] + 0"),
    (BODY, "exit('bye')"),
    ('"glow", "amplifier', '"ipc", "amplifier'),
    ('"glow", "amplifier', 'None, "amplifier'),
    ('"glow", "amplifier', '3, "amplifier'),
    ('"glow", "amplifier', '"a\\nb", "amplifier'),
    ("name, title, acts_at =", "title, title, acts_at ="),
    ("Stage.LIGHT", "7"),
    ("Stage.LIGHT", "None"),
    ('("electrons",)', '("protons",)'),
    ('("electrons",)', "7"),
    ("(frozen=True)", ""),
    ("@dataclass(frozen=True)", ""),
    ("(Effect)", ""),
    ("(Effect)", "(Exception)"),
    ("(Effect)", "(Effect, 3)"),
    ("electrons: float", "electrons: 'nowhere'"),
    ("electrons: float", "electrons: complex"),
    ("100.0, unit", "'many', unit"),
    ("100.0, ", ""),
    ("quantity(100.0", "quantity([]"),
    ("low=0", "low='a'"),
    ("self, mean, shot", "self"),
    ("from dataclasses", "import nowhere\nfrom dataclasses"),
    ("class Glow", "clas Glow"),
    ("from dataclasses", "raise SystemExit\nfrom dataclasses"),
    ("import Effect,", "import "),
    ("from dataclasses", "print(1 / 0)\nfrom dataclasses"),
    ("from dataclasses", "\x00"),
    ("from dataclasses", "import sys; sys.exit(0)\nfrom dataclasses"),
    ("    ", "\t  "),
    ("name, title", '__slots__ = ("x",)\n    name, title'),
    ("low=0", "low=1e9"),
    (STEP, "def __post_init__(self):\n        raise ValueError('x')\n    def photons"),
    (
        STEP,
        "def check(self, bench):\n        raise InputError('not here; leave it out')\n"
        "    def photons",
    ),
    (STEP, "def check(self, bench):\n        1 / 0\n    def photons"),
    (STEP, "halo = 'wide'\n    def photons"),
    (STEP, "halo = -5\n    def photons"),
    (STEP, "halo = 10**9\n    def photons"),
    (STEP, "frames_back = -1\n    def photons"),
    (STEP, "frames_back = 10**9\n    def photons"),
    (STEP, "def states(self, states, recording):\n        return None\n    def photons"),
    (STEP, "def detector(self, maps, bench, rows):\n        return 3\n    def photons"),
    (STEP, "def readout(self, adu, shot):\n        return adu * float('nan')\n    def photons"),
    (STEP, "def signal(self, signal, shot):\n        return signal[:, :1]\n    def photons"),
)
VALUES = (
    "{}",
    "{electrons: 50}",
    "{electrons: -1}",
    "{electrons: many}",
    "{protons: 1}",
    "null",
    "[]",
)


def _own(case: Case) -> None:
    """One change of a good file, or two, and values for it in the bench file."""
    text = GOOD
    chosen = [CHANGES[case.number % len(CHANGES)]]
    if case.number >= len(CHANGES):
        chosen.append(CHANGES[int(case.rng.integers(len(CHANGES)))])
    for old, new in chosen:
        text = text.replace(old, new) if old else text
    own = case.folder / "own.py"
    own.write_text(text, encoding="utf-8")
    values = VALUES[0] if case.number < len(CHANGES) else str(case.pick(*VALUES))
    file, acq = case.folder / "bench.yaml", case.folder / "acq"
    file.write_text(f"{small_bench()}\neffects:\n  glow: {values}\n", encoding="utf-8")
    names = ["own.py", "effects", "glow"]
    pixcal("simulate", file, "--out", acq, "--own", own, *RUNTIME, names=names)
    frames = np.asarray(fits.getdata(next((acq / "vertical").glob("*.fits*"))))
    if frames.shape[-2:] != (12, 10):
        raise Broken(f"an effect changed the window to {frames.shape}")


KINDS = [Kind("own-effects", "files with your own effects", _own, 200)]
