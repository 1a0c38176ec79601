// Uploads a file with tus-js-client in several ways: node upload.mjs ENDPOINT FILE prints a JSON object.
//
// broken: in pieces, stopped half-way and gone on with by another instance; whole: with the creation
// itself; posted: by POST instead of PATCH; removed: created, then terminated.

import { createReadStream } from "node:fs";
import { stat } from "node:fs/promises";
import { basename } from "node:path";

import { Upload } from "tus-js-client";

const [endpoint, path] = process.argv.slice(2);
const uploadSize = (await stat(path)).size;
const metadata = { filename: basename(path), filetype: "application/octet-stream" };

function send(options, stopAt = Infinity) {
  return new Promise((resolve, reject) => {
    const upload = new Upload(createReadStream(path), {
      endpoint,
      uploadSize,
      metadata,
      chunkSize: 1 << 20,
      retryDelays: [0, 500],
      onSuccess: () => resolve({ url: upload.url, stopped: false }),
      onError: reject,
      onChunkComplete: (_size, accepted) => {
        if (accepted >= stopAt && accepted < uploadSize) {
          upload.abort().then(() => resolve({ url: upload.url, stopped: true }), reject);
        }
      },
      ...options,
    });
    upload.start();
  });
}

const first = await send({}, uploadSize / 2);
let from = null;
const onProgress = (sent) => (from ??= sent);
const second = await send({ uploadUrl: first.url, onProgress });
const whole = await send({ uploadDataDuringCreation: true });
const posted = await send({ overridePatchMethod: true });
const removed = await send({}, 1);
await Upload.terminate(removed.url);
console.log(
  JSON.stringify({
    broken: { url: second.url, same: first.url === second.url, stopped: first.stopped, from },
    whole: whole.url,
    posted: posted.url,
    removed: removed.url,
  }),
);
