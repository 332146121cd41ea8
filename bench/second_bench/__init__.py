"""A second bench: acquisitions with a known truth, independent of pixcal.

Two single-mode fibres light a detector. The mode of each fibre is propagated by HCIPy; the
detector's physics is that of GalSim and Pyxel where these have it, else written here from the
physics. Nothing of ``pixcal`` is imported, so an error common to its simulation and its diagnosis
is exposed.

One acquisition, and its truth in a file elsewhere::

    python -m second_bench ordinary --seed 3 --out acq --truth truth.json
    python -m second_bench ordinary/dust --seed 3 --out acq --truth truth.json
    python -m second_bench lag --seed 3 --out acq --truth truth.json
    python -m second_bench lag/traps --strength 0.8 --bench plain --out acq --truth truth.json
    python -m second_bench ipc+bias_drift/walk --seed 4 --out acq --truth truth.json
    python -m second_bench --list

A case is ``ordinary`` (nothing is wrong), or the name of an effect, or several joined by ``+``.
After a slash follows the law of the effect, or the only variation of an ordinary bench; without it
the seed decides. ``--strength`` runs from 0 (barely visible) to 1 (strong).

It needs ``pip install pixcal[second-bench]``: HCIPy, GalSim, and for two laws, ``lag/traps`` and
``charge_transfer/traps``, Pyxel.
"""
