"""The ACC robust-control benchmark: published designs and ours on a thousand uncertain plants."""
