"""Reproduction of the figures of Rousset et al.: one module per figure, and common parts.

Each ``figure_NN`` has ``make(lab)``, which simulates the bench of ``configs/paper``, analyses it
and returns an `outcome.Outcome`: a picture, and what was measured beside what the paper states.
"""
