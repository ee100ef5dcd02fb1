"""The validation ladder: each case is one small file that runs a solver at a resolution and compares it with a formula or an experiment.

A case owns its scene, its reference and its tolerance; ``python -m sim.validation`` runs all at three resolutions and writes docs/validation.md.
"""
