"""Quantization: what becomes int8 and why (scheme, rules, plan, overrides)."""
