"""Figures of a running daemon as Prometheus reads them."""
