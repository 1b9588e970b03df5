//! Lists the arrays in a `.npy`, `.npz`, `.pkl` or `.pt` file: `list_arrays FILE`.

use std::fs::File;
use std::path::Path;

use array_files::npz::Npz;
use array_files::pickle::{self, Value};
use array_files::read_file;
use array_files::torch::{TorchFile, is_torch};

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
    if let Ok(mut npz) = Npz::open(path)
        && !npz.keys().iter().any(|key| key.ends_with("data.pkl"))
    {
        for key in npz.keys().to_vec() {
            match npz.value(&key) {
                Ok(value) => list(&key, &value),
                Err(error) => println!("{error}"),
            }
        }
        return Ok(());
    }
    let value = if is_torch(&read_file(path)?) {
        let mut file = TorchFile::open(&name, File::open(path)?)?;
        let root = file.root().clone();
        file.resolve("", &root)?
    } else {
        pickle::read(path)?
    };
    list("", &value);
    Ok(())
}
