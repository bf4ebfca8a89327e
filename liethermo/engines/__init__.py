"""Engines: they turn the definition of a step into fast code.

An engine takes the steps of one method on one system: the array engine in JAX, the compiled engine in machine code for
small systems, the sparse engine with sparse matrices for large networks.
:class:`.select_engine.EngineWithFallback` picks one.
"""
