"use strict";
// The inverse of dcreg/plot/packing.py: base 85 (RFC 1924), then gzip.

const DIGITS = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz!#$%&()*+-;<=>?@^_`{|}~";
const digitOf = new Uint8Array(128);
[...DIGITS].forEach((digit, value) => { digitOf[digit.charCodeAt(0)] = value; });

function bytesOf(text) {
  const groups = Math.ceil(text.length / 5), missing = 5 * groups - text.length;
  const bytes = new DataView(new ArrayBuffer(4 * groups));
  for (let group = 0, at = 0; group < groups; group += 1) {
    let value = 0;
    for (const end = at + 5; at < end; at += 1) value = 85 * value + (at < text.length ? digitOf[text.charCodeAt(at)] : 84);
    bytes.setUint32(4 * group, value);
  }
  return new Uint8Array(bytes.buffer, 0, 4 * groups - missing);
}

const unpacked = (text) => new Response(new Blob([bytesOf(text)]).stream().pipeThrough(new DecompressionStream("gzip")));

// plotly.js is a script; its text becomes an element of the page.
async function loadPlotly(packed) {
  const script = document.createElement("script");
  script.textContent = await unpacked(packed).text();
  document.head.append(script);
  return window.Plotly;
}
