"""The checker of certificates: proves a stored claim again, in ball arithmetic, from the file alone.

It shares nothing with the propagators, the recorder of programs or the robots; what it trusts is listed in
``docs/certificates.md``. One idea a file: :mod:`~sagemp_cli.checker.document` reads, with
:mod:`~sagemp_cli.checker.program` and :mod:`~sagemp_cli.checker.scene`; :mod:`~sagemp_cli.checker.cover` and
:mod:`~sagemp_cli.checker.clearance` prove the geometry; :mod:`~sagemp_cli.checker.cell` redoes the reach sets, one
:mod:`~sagemp_cli.checker.step` after the other; :mod:`~sagemp_cli.checker.check` puts the parts together;
:mod:`~sagemp_cli.checker.claim` and :mod:`~sagemp_cli.checker.equations` print what it is all about.
"""
