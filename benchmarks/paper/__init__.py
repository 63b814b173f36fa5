"""The paper's tables, figures and findings, recomputed for another driver."""
