"""Names of earlier days, for lessons that still use them; see `peg_touch_tests`."""

from cmc.studies.peg_touch_tests import (  # noqa: F401
    ERROR_BINS,
    SHIFTS,
    TestConfig,
    equilibrium,
    predicted_oscillation,
    record,
    shifted,
)
