"""What a command does, as silent typed functions: a file each.

Each takes files first, then options (a frozen dataclass, checked once), then a listener
for progress, and returns a :class:`~me2e_compress.workflows.result.Result`.
"""
