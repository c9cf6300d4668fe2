"""Analytic scenes with exact truth: intersections in closed form, light in closed form, shadows by quadrature.

No OpenCL and nothing of the server: these scenes are what the pipeline is measured against.
"""
