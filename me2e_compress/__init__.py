"""Compress modular end-to-end driving models and measure what it costs on the road."""

__version__ = "0.1.0"
