"""Modules: which node of a graph belongs to which part of the driving stack."""
