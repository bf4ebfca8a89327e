"""Shared settings: property tests are deterministic, so that a failure here is a failure everywhere."""

import hypothesis

hypothesis.settings.register_profile(
    "liethermo", derandomize=True, deadline=None, database=None, print_blob=True, max_examples=10
)
hypothesis.settings.load_profile("liethermo")
