"""How accurate, robust and cheap the default profile is: `make bench BENCH_ARGS="--only accuracy"`."""
