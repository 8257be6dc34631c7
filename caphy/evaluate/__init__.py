"""How well dressed avatars match scans that nothing was trained on: the table of CaPhy, section 4."""
