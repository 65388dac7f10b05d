"""The same examples of hypothesis in every run, and no failure because the machine is busy."""

from hypothesis import HealthCheck, settings

settings.register_profile("strokes", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("strokes")
