"""The toolkit's own driver: a small modular end-to-end stack, trained to drive."""
