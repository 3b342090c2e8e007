"use strict";
// Unpacks the parts of a page, which follow below, while it is read. `what` is what the page shows, `early` are the parts that the
// first picture needs besides the program, its head and stencils; they are unpacked at once. `play` names the function that starts.
async function loadPage({ what, early, play }) {
  const message = document.getElementById("message");
  const say = (text) => { message.textContent = text; message.hidden = false; };
  const tell = (text) => { const note = document.getElementById("note"); note.textContent = text; note.hidden = !text; };
  const kind = { alpha: true, depth: true, stencil: false, antialias: false }; // as three.js asks for it
  if (!document.getElementById("canvas").getContext("webgl2", kind))
    return say(`This ${what} needs WebGL2, which this browser lacks or has switched off: open it in a current browser.`);
  if (!("DecompressionStream" in window)) return say(`This ${what} needs a newer browser, one that can unpack compressed data.`);
  const cut = () => Error(`The file of this ${what} is cut short: copy it again, or export it again.`);
  const find = async (name) => {
    for (;;) {
      const part = document.getElementById("film-" + name), reading = document.readyState === "loading";
      if (part && (part.nextSibling || !reading)) return part;
      if (!reading) throw cut();
      await new Promise((resolve) => setTimeout(resolve, 4));
    }
  };
  const bytes = (text) => Uint8Array.fromBase64 ? Uint8Array.fromBase64(text)
    : Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const unpack = async (name) => {
    const part = await find(name);
    const text = part.textContent;
    if (text.length !== Number(part.dataset.size)) throw cut();
    const packed = bytes(text);
    part.remove();
    const inflate = new DecompressionStream("deflate"), writer = inflate.writable.getWriter();
    writer.write(packed).catch(() => {}); // the reader tells what is wrong
    writer.close().catch(() => {});
    return new Uint8Array(await new Response(inflate.readable).arrayBuffer());
  };
  const first = Object.fromEntries(["code", "head", "stencils", ...early].map((name) => [name, unpack(name)]));
  for (const name in first) first[name].catch(() => {});
  const read = (name) => first[name] ?? unpack(name);
  try {
    const code = document.createElement("script");
    code.textContent = new TextDecoder().decode(await read("code"));
    document.head.append(code);
    await window[play](read, tell);
    message.hidden = true;
  } catch (error) {
    console.error(error);
    say(error.message.startsWith("The file") ? error.message : `This ${what} cannot be shown (${error.message}).`);
  }
}
