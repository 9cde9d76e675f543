"""One-to-one matchings of fixed size, and the local steps that use them."""
