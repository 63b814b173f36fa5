"""Readers of nuScenes and Bench2Drive for ``me2e-compress frames --from``."""
