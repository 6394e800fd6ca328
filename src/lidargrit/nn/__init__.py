"""Parts without opinions: blocks that models share, tensors → tensors."""
