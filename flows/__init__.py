"""Order, fan-out and reruns: the paper's method as Prefect flows, and the command line."""
