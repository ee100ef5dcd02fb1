"""Smoothed particle hydrodynamics: weakly compressible and divergence-free."""
