"""The compiled twins (numba) of an explicit step: stencils, mapping to the grid and back, stress.

Kernels work on the solver's own arrays: those of points component-major ``(k, n)``, those of nodes node-major
``(nnodes, k)``.  Points are cut into ``CHUNKS`` pieces whatever the number of threads; each adds to its own copy of the
band of nodes that it touches, and copies are summed in a fixed order, so results do not depend on threads.

Kernels over points end in a range of chunks and let go of Python's lock; :class:`~skfem_mpm.kernels.crew.Crew` gives
each thread a range.  Numba's own parallel loops would take several times as long to compile.  No kernel takes a
function as an argument: those are compiled anew in every process.  Tuples such as ``kt = (0,) * K`` are there for their
length, which is known when a kernel is compiled.  Numba's disk cache looks at the file of a function only, not at those
of the functions that it calls: after a change to a kernel, delete ``kernels/__pycache__``.
"""
