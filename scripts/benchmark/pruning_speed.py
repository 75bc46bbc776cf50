def measure(a,b): return []
