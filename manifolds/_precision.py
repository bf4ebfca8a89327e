"""Switches JAX to 64-bit floating point, before anything is traced."""

import jax

jax.config.update("jax_enable_x64", True)
