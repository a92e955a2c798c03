"""The framebuffers of render ranks meet on the first of them. One policy a file.

Sort-last, in the minimum of words:

=============  ====================================================================================================
choose         ``make_compositor``: a policy by name; ``auto`` takes the one that the model says is done first
direct         every rank sends to the root
rounds         what the next three share: rounds of exchanges within groups, then the root gathers
direct_reduce  one round, the group is all: each rank is sent its part of the picture by all others (direct-send)
binary_swap    groups of two
radix_k        groups of up to k (Peterka, Goodell, Ross, Shen, Thakur 2009)
mpi_min        MPI_Reduce with MPI_MIN: the reference
exchange       what crosses between two ranks, and what a rank holds of the picture
model          seconds, bytes and messages of each policy, as functions of ranks, pixels and links
=============  ====================================================================================================

Sort-first, side by side: ``tiles``.

Minimum is commutative and associative: all policies give the same bits. Background is not sent; a part of a picture on
which a rank has drawn nothing is a header without payload.
"""

from .choose import make_compositor
from .exchange import Compositor

__all__ = ["Compositor", "make_compositor"]
