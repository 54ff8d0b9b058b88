/** How faithful gradients are: cosines of int8, float and true ones. */

/** What a probe of one batch says of the SGM behind each layer; `outputs`: tensors by name. */
export function compared(outputs, layers) {
  return Object.fromEntries(layers.map((k) => {
    const of = (kind) => outputs[`${kind}${k}`].data;
    return [k, {
      int8Float: cosine(of("int8"), of("float")),
      int8True: cosine(of("int8"), of("true")),
      floatTrue: cosine(of("float"), of("true")),
      clipped: of("clipped")[0],
    }];
  }));
}

/** 0 if either vanishes. */
export function cosine(a, b) {
  let [ab, aa, bb] = [0, 0, 0];
  for (let i = 0; i < a.length; i++) {
    ab += a[i] * b[i];
    aa += a[i] * a[i];
    bb += b[i] * b[i];
  }
  return aa > 0 && bb > 0 ? ab / (Math.sqrt(aa) * Math.sqrt(bb)) : 0;
}

/** The mean of every number over a run's probes. */
export function meanOver(probes) {
  const mean = {};
  for (const { layers } of probes) {
    for (const [k, values] of Object.entries(layers)) {
      mean[k] ??= {};
      for (const [name, value] of Object.entries(values)) {
        mean[k][name] = (mean[k][name] ?? 0) + value / probes.length;
      }
    }
  }
  return mean;
}
