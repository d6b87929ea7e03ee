"""The experiments of the four papers, repeated on simulated data with truth: `make papers`."""
