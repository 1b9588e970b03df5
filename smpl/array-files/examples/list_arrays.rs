//! Lists the arrays in a `.npy`, `.npz`, `.pkl` or `.pt` file: `list_arrays FILE`.

use std::fs::File;
use std::path::Path;

use array_files::npz::Npz;
use array_files::pickle::{self, Value};
use array_files::torch::{TorchFile, is_torch};
use array_files::{Error, read_file};

fn list(name: &str, value: &Value) {
    match value {
        Value::Array(array) => println!("{name}: {:?}", array.shape),
        Value::Dict(entries) => {
            for (key, value) in entries {
                list(&format!("{name}.{}", key.as_str().unwrap_or(key.type_name())), value);
            }
        }
        other => match other.items() {
            Some(items) => items.iter().enumerate().for_each(|(i, item)| list(&format!("{name}[{i}]"), item)),
            None => println!("{name}: {}", other.type_name()),
        },
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let name = std::env::args().nth(1).ok_or("usage: list_arrays FILE")?;
    let path = Path::new(&name);
    let value = match Npz::open(path) {
        Ok(mut npz) if !npz.keys().iter().any(|key| key.ends_with("data.pkl")) => {
            let entries = npz.keys().to_vec().into_iter().map(|key| Ok((Value::Str(key.clone()), npz.value(&key)?)));
            Value::Dict(entries.collect::<Result<_, Error>>()?)
        }
        _ if is_torch(&read_file(path)?) => {
            let mut file = TorchFile::open(&name, File::open(path)?)?;
            let root = file.root().clone();
            file.resolve("", &root)?
        }
        _ => pickle::read(path)?,
    };
    list("", &value);
    Ok(())
}
