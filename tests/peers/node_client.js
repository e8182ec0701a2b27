// Works off tests/peers/script.json: node_client.js modbus-serial|jsmodbus PORT, with NODE_PATH at the packages.
"use strict";
const net = require("net");
const script = require("./script.json");

// A reader or writer gives the values read, or throws an error that names the exception.
async function modbusSerial(port) {
  const ModbusRTU = require("modbus-serial");
  const client = new ModbusRTU();
  await client.connectTCP("127.0.0.1", { port });
  client.setTimeout(10000);
  const calls = {
    1: (s, n) => client.readCoils(s.address, n),
    2: (s, n) => client.readDiscreteInputs(s.address, n),
    3: (s, n) => client.readHoldingRegisters(s.address, n),
    4: (s, n) => client.readInputRegisters(s.address, n),
    5: (s) => client.writeCoil(s.address, s.values[0] === 1),
    6: (s) => client.writeRegister(s.address, s.values[0]),
    15: (s) => client.writeCoils(s.address, s.values.map((v) => v === 1)),
    16: (s) => client.writeRegisters(s.address, s.values),
  };
  return {
    ask: async (step, count) => {
      client.setID(step.unit);
      return (await calls[step.function](step, count)).data;
    },
    exception: (error) => error.modbusCode,
    close: () => new Promise((done) => client.close(done)),
  };
}

async function jsmodbus(port) {
  const { ModbusTCPClient } = require("jsmodbus");
  // A client belongs to one unit and one socket, and must be there before the socket connects.
  const units = new Map();
  const client = async (unit) => {
    if (!units.has(unit)) {
      const socket = new net.Socket();
      units.set(unit, new ModbusTCPClient(socket, unit, 10000));
      socket.connect(port, "127.0.0.1");
      await new Promise((done, fail) => socket.once("connect", done).once("error", fail));
    }
    return units.get(unit);
  };
  const calls = {
    1: (c, s, n) => c.readCoils(s.address, n),
    2: (c, s, n) => c.readDiscreteInputs(s.address, n),
    3: (c, s, n) => c.readHoldingRegisters(s.address, n),
    4: (c, s, n) => c.readInputRegisters(s.address, n),
    5: (c, s) => c.writeSingleCoil(s.address, s.values[0] === 1),
    6: (c, s) => c.writeSingleRegister(s.address, s.values[0]),
    15: (c, s) => c.writeMultipleCoils(s.address, s.values.map((v) => v === 1)),
    16: (c, s) => c.writeMultipleRegisters(s.address, s.values),
  };
  return {
    ask: async (step, count) => (await calls[step.function](await client(step.unit), step, count)).response.body.valuesAsArray,
    exception: (error) => error.response && error.response.body.code,
    close: async () => units.forEach((one) => one.socket.destroy()),
  };
}

async function main() {
  const [library, port] = process.argv.slice(2);
  const peer = await { "modbus-serial": modbusSerial, jsmodbus }[library](Number(port));
  for (const step of script) {
    const wanted = step.expect || [];
    let exception, values;
    try {
      values = await peer.ask(step, wanted.length);
    } catch (error) {
      exception = peer.exception(error);
      if (exception === undefined) throw new Error(`${step.what}: ${error.message || error.err || error}`);
    }
    if (exception !== step.exception) throw new Error(`${step.what}: exception ${exception}, wanted ${step.exception}`);
    if (exception === undefined && step.expect) {
      const got = Array.from(values).slice(0, wanted.length).map(Number);
      if (JSON.stringify(got) !== JSON.stringify(wanted)) throw new Error(`${step.what}: got ${got}, wanted ${wanted}`);
    }
  }
  await peer.close();
  console.log("ok");
}

main().catch((error) => {
  console.log(error.message || error);
  process.exit(1);
});
