"""Closing the loop: controllers, missions and the rules that keep vehicle and net whole."""
