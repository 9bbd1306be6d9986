"""Pages and charts: one HTML kit, one kit for SVG charts, and a module for each page.

Imports results; plots what others computed.
"""
