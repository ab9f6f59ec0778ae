"""Records what one step of a stranger's loop does, as a program that every propagator can run."""

import sagemp_cli.reachability.tracing.arithmetic
import sagemp_cli.reachability.tracing.conversions
import sagemp_cli.reachability.tracing.entries
import sagemp_cli.reachability.tracing.matrices  # noqa: F401  (each registers what torch's functions do on traced values)
