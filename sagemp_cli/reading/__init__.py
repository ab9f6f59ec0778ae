"""Files that somebody else may have written: opened in a process of their own, under limits of time and memory.

The libraries that read HDF5 and NPZ are not made for hostile input: a few changed bytes let them loop for ever, take
many GB or crash. So only a *reader process* (:mod:`~sagemp_cli.reading.process`) opens such files; it hands over plain
arrays and texts (:mod:`~sagemp_cli.reading.tree`), and what it does with a file ends with it. A command has at most one
reader, started with the first file. This module itself imports nothing: a reader starts in a tenth of a second.
"""
