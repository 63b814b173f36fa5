"""The work of each command as a silent, typed function, one file each.

A workflow takes files first, then options (a frozen dataclass that checks itself), then
a listener for progress; it returns a
:class:`~me2e_compress.workflows.result.Result`.
"""
