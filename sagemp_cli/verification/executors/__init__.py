"""Where cells are proved: here, in worker processes, or on a cluster. The tubes are the same bits everywhere.

Provided the machines compute alike: processors of different kinds may round sums in a different order, which changes
last bits, never soundness.
"""

from sagemp_cli.verification.executors.cluster import Dask
from sagemp_cli.verification.executors.executor import Executor
from sagemp_cli.verification.executors.processes import Processes
from sagemp_cli.verification.executors.serial import Serial

__all__ = ["Dask", "Executor", "Processes", "Serial"]
