"""A model of the zoo in accelerate: pip install accelerate; accelerate launch THIS_FILE LOG.

The device and the number of processes are those of `accelerate config`, or of its options.
"""

import sys

import torch
from accelerate import Accelerator

import offbeat as ob

if __name__ == "__main__":
    log = ob.windows(ob.read(sys.argv[1]), 100, cut="consecutive")
    model = ob.make_model("gru_d", log, scaler="robust")
    loader = ob.data_loader(log, batch_size=16, shuffle=True, scaler=model.scaler)
    optimizer = torch.optim.Adam(model.parameters(), lr=3e-3)
    accelerator = Accelerator()
    model, optimizer, loader = accelerator.prepare(model, optimizer, loader)
    for epoch in range(3):
        for batch in loader:
            loss = ((model(batch).mean - batch.values) ** 2)[batch.targets].mean()
            accelerator.backward(loss)
            optimizer.step()
            optimizer.zero_grad()
        accelerator.print(f"epoch {epoch}: mean squared error {loss.item():.4f}")
