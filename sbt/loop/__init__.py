"""The loop that every campaign runs in, and the metamodel that it fits."""
