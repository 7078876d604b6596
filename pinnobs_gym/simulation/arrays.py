"""The functions of an array's own library, for equations that serve NumPy, torch and symbols."""

from __future__ import annotations

from typing import Any

import array_api_compat
import numpy as np


def array_namespace(x: Any) -> Any:
    """Return the array API's functions for an array, as `array_api_compat.array_namespace` does.

    Those of NumPy arrays are NumPy's own, which have all of the standard's names since version 2.1.
    The other module's take a tenth of a second to import and some time in each call.
    """
    return np if isinstance(x, np.ndarray | np.generic) else array_api_compat.array_namespace(x)
