"""Records what one step of a stranger's loop does, as a program that every propagator can run."""

import sagemp_cli.reachability.program.activations
import sagemp_cli.reachability.program.arithmetic
import sagemp_cli.reachability.program.choices
import sagemp_cli.reachability.program.conversions
import sagemp_cli.reachability.program.entries
import sagemp_cli.reachability.program.matrices
import sagemp_cli.reachability.program.normalising  # noqa: F401  (each registers what torch's functions do on traced values)
