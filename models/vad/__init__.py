"""VAD-tiny in torch: the vectorised driving stack at its published dimensions."""
