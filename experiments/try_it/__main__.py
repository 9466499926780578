"""`python -m experiments.try_it`."""

from experiments.try_it import main

main()
