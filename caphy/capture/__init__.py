"""A virtual capture rig: simulated people in simulated clothes, scanned; the truth is kept aside.

Nothing here knows how scans are read or used: it only writes files.
"""
