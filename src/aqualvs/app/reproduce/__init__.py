"""`aqualvs reproduce`: the paper's experiments, each beside ours.

Constantinou, Georgiades and Loizou, Robotics 2021, 10, 126, doi:10.3390/robotics10040126.
"""
