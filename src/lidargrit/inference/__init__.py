"""A trained run used: sampled, completed and compressed scans."""
