"""Hours of faults on real processes, sockets and network namespaces, with limits that the end of the run reports."""
