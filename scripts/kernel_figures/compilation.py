"""Print the compiler's CPU time in s for an algorithm of a system: SYSTEM TEMPLATE."""

import json
import resource
import sys

from pinnobs_gym.simulation.kernels.asked import ask
from pinnobs_gym.systems import SYSTEMS


def main(name: str, template: str) -> None:
    """Compile and print."""
    found = ask(SYSTEMS.resolve(name)(), template)
    assert not isinstance(found, str), found
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(json.dumps(used.ru_utime + used.ru_stime))


if __name__ == "__main__":
    main(*sys.argv[1:])
