"""The checker of certificates: proves a stored claim again, in ball arithmetic, from the file alone.

It shares nothing with the propagators; what it trusts is listed in ``docs/certificates.md``. One idea a file:
:mod:`~sagemp_cli.checker.limits` refuses what costs too much to read, :mod:`~sagemp_cli.checker.document` reads,
:mod:`~sagemp_cli.checker.cover` and :mod:`~sagemp_cli.checker.scene` prove the geometry,
:mod:`~sagemp_cli.checker.cell` redoes the reach sets, :mod:`~sagemp_cli.checker.check` puts the parts together.
"""
