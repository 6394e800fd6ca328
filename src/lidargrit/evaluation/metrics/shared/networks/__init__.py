"""Networks that others have trained: range images → features → how far two sets of them are apart."""
