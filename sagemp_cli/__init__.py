"""Certified tracking of generative motion plans (SaGe-MP).

The package is layered and imports point downwards only:
``cli > stages > {library, execution, report} > {reachability, planners, trackers, experts} >
closed_loop > {dynamics, scenes} > sets``; ``storage``, ``config`` and ``errors`` serve all layers.
"""

__version__ = "0.1.0"
