"""Yardsticks: the plain way to do what is measured, as processes of their own."""
