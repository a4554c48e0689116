"""How many examples: `quick` by default, `slow` for a night, chosen by the environment variable HYPOTHESIS_PROFILE."""

import os

from hypothesis import HealthCheck, Phase, settings

SHARED = {
    "deadline": None,
    "derandomize": True,  # the same examples in every run: a failure is there again
    "database": None,
    "phases": [Phase.explicit, Phase.generate],  # numbers come from a seed: there is nothing to shrink
    "suppress_health_check": [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.differing_executors],
}
settings.register_profile("quick", max_examples=8, **SHARED)
settings.register_profile("slow", max_examples=400, **(SHARED | {"derandomize": False, "print_blob": True}))
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "quick"))
