"""The published results that mrctl reproduces, and the comparisons that go beyond them."""
