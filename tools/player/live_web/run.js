// Runs the built worker without a browser: node run.js WORKER BLOCK STATE MESSAGES
// It gets the block and the messages (JSON), writes the last state to STATE (float32), and prints all other answers (JSON).
import { readFileSync, writeFileSync } from "node:fs";
import { runInThisContext } from "node:vm";

const [worker, block, state, messages] = process.argv.slice(2);
const answers = [];
let last = new Float32Array();

globalThis.self = {
  postMessage: (message) => {
    if (message.kind === "state") last = message.moved;
    else if (message.kind !== "solver") answers.push(message);
  },
};
runInThisContext(readFileSync(worker, "utf8"));
for (const data of [{ kind: "load", bytes: new Uint8Array(readFileSync(block)) }, ...JSON.parse(messages)]) {
  const [before, known] = [process.cpuUsage(), answers.length];
  await globalThis.self.onmessage({ data });
  const { user, system } = process.cpuUsage(before);
  for (const answer of answers.slice(known)) answer.cpu = (user + system) / 1e6; // s
}
writeFileSync(state, new Uint8Array(last.buffer, last.byteOffset, last.byteLength));
process.stdout.write(JSON.stringify(answers));
