"""The figures of Rousset et al. made again: one module a figure, and what they share.

Each ``figure_NN`` has ``make(lab)``, which simulates the bench of ``configs/paper``, analyses it
and returns an `outcome.Outcome`: a picture, and what was measured beside what the paper states.
"""
