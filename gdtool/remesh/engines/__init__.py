"""Run native remeshers in child processes and choose the best of what they return.

`adapters` calls one engine, `candidate` repairs and judges one result, `search` tries engines and densities in order.
"""
