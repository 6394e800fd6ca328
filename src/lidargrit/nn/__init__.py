"""Networks and building blocks that models share: tensors → tensors."""
