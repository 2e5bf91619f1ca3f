"""Modules with the functions of other packages, for programs that use those."""
