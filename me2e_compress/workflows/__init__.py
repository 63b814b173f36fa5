"""What a command does, as silent typed functions: a file each.

Files first, then options (a frozen dataclass, checked once), then who is told how it
goes; what was found comes back as a :class:`~me2e_compress.workflows.result.Result`.
"""
