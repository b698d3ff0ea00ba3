"""Memory of a process by itself."""

import resource
import sys
from pathlib import Path


def peak_mib() -> float:
    """Peak resident memory of this process [MiB].

    Linux counts in `getrusage` the process that started this one, as it was then.
    """
    status = Path("/proc/self/status")
    if status.exists():
        lines = status.read_text().splitlines()
        return int(next(line for line in lines if line.startswith("VmHWM")).split()[1]) / 1024
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
