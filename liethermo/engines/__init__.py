"""How the definition of a step becomes fast code.

An engine takes the steps of one method on one system: arrays in JAX, machine code for small systems,
sparse matrices for large networks. :class:`.choice.Chosen` picks one.
"""
