"""TCP, trajectory-guided control prediction, in torch at its published dimensions."""
