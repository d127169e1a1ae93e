"""Train the model: loop, losses, optimisers, distribution over processes and logs."""
