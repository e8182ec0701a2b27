// A BACnet client, node-bacnet: bacnet_node.js OWN_ADDRESS OWN_PORT GATEWAY NETWORK, with NODE_PATH at the packages. Takes orders line by
// line, as JSON lists, and prints the answer to each as JSON: a value, or {"error": text}.
//
// ["read", STATION, TYPE, INSTANCE, PROPERTY] ["write", STATION, TYPE, INSTANCE, VALUE, PRIORITY] ["objects", STATION]
// ["cov", STATION, TYPE, INSTANCE, COUNT]: subscribes without confirmation and waits for so many notifications.
"use strict";
const readline = require("readline");
const bacnet = require("node-bacnet");

const [address, port, gateway, network] = process.argv.slice(2);
const client = new bacnet({ port: Number(port), interface: address, broadcastAddress: "127.255.255.255", apduTimeout: 6000 });
const station = (number) => (number === 0 ? { address: gateway } : { address: gateway, net: Number(network), adr: [number] });
const tags = bacnet.enum.ApplicationTag;

function called(start) {
  return new Promise((done) => start((error, value) => done(error ? { error: String(error.message ?? error) } : value)));
}

const told = [];
let wanted = () => {};
client.on("covNotifyUnconfirmed", (message) => {
  const payload = message.payload ?? message;
  for (const entry of payload.values) {
    if (entry.property.id === bacnet.enum.PropertyIdentifier.PRESENT_VALUE) told.push(entry.value[0].value);
  }
  wanted();
});

const orders = {
  read: async (number, type, instance, property) => {
    const answer = await called((next) => client.readProperty(station(number), { type, instance }, property, next));
    return answer.error ? answer : answer.values.map((value) => value.value);
  },
  objects: async (number) => {
    const device = { type: 8, instance: 4194303 };
    const answer = await called((next) => client.readProperty(station(number), device, 76, next));
    return answer.error ? answer : answer.values.map(({ value }) => [value.type, value.instance]);
  },
  write: async (number, type, instance, value, priority) => {
    const kind = value === null ? tags.NULL : typeof value === "boolean" ? tags.ENUMERATED : tags.REAL;
    const values = [{ type: kind, value: typeof value === "boolean" ? Number(value) : value }];
    const answer = await called((next) => client.writeProperty(station(number), { type, instance }, 85, values, { priority }, next));
    return answer?.error ? answer : "done";
  },
  cov: async (number, type, instance, count) => {
    told.length = 0;
    const answer = await called((next) => client.subscribeCov(station(number), { type, instance }, 9, false, false, 60, {}, next));
    if (answer?.error) return answer;
    console.error("subscribed");
    await new Promise((done) => {
      wanted = () => told.length >= count && done();
      wanted();
    });
    return told.slice(0, count);
  },
};

client.on("listening", async () => {
  for await (const line of readline.createInterface({ input: process.stdin })) {
    const [name, ...rest] = JSON.parse(line);
    console.log(JSON.stringify(await orders[name](...rest)));
  }
  client.close();
  process.exit(0);
});
client.on("error", (error) => {
  console.error(String(error));
  process.exit(1);
});
