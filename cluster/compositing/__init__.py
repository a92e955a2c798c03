"""Sort-last compositing: the framebuffers of all ranks meet on rank 0 in the minimum of words. One policy a file."""
