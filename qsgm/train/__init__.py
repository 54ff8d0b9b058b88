"""The host side: drawing, pretraining, folding, quantizing, exporting. Needs the extra `train`."""
