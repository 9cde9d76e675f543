"""One-to-one matchings of fixed size, and the local searches that use them."""
