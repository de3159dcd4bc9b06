"""What the commands of ``quell`` print: one module for each."""
