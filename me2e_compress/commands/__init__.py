"""The work of each command as a silent, typed function.

A workflow takes files first, then :mod:`~me2e_compress.commands.options`, then
a listener for progress; it returns a
:class:`~me2e_compress.commands.result.Result`.
"""
