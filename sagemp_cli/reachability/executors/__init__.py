"""Where cells are proved: here, in worker processes, or on a cluster. The tubes are the same bits everywhere.

Provided the machines compute alike: processors of different kinds may round sums in a different order, which changes
last bits, never soundness.
"""

from sagemp_cli.reachability.executors.cluster import Dask
from sagemp_cli.reachability.executors.executor import Executor
from sagemp_cli.reachability.executors.processes import Processes
from sagemp_cli.reachability.executors.serial import Serial

__all__ = ["Dask", "Executor", "Processes", "Serial"]
