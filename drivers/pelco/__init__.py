"""Pan/tilt heads of the security world that speak Pelco-D or Pelco-P."""
