"""A video of a person in, the same video with the avatar's clothes on out.

In an environment of its own (requirements.txt), from the repository's root or with caphy installed without its
dependencies:

    python -m service.clients.monocular video.mp4 -o dressed.mp4
"""
